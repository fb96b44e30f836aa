"""The stages of `engram lab bench`, each timed against the plain pipeline in the same run."""
