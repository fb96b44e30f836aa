"""The command line: each verb parses, calls one function and prints."""

__all__ = ["main"]


def main() -> None:
    """Runs the program."""
    # Packages that bring verbs import from this one: the program is made when it runs.
    from engram.cli.app import main as run

    run()
