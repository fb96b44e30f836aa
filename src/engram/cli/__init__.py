"""The command line: each verb parses, calls one function and prints."""

from engram.cli.app import main

__all__ = ["main"]
