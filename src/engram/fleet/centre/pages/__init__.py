"""Pages for people: rendered on the server, with one small script and one style sheet."""
