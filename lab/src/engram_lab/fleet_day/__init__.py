"""A fleet's day: robots of the town, a centre, and a link that breaks."""
