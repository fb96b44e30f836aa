"""The fleet's verbs of the command line."""
