"""The command line: each verb parses, calls one function and prints."""

import os
import sys

__all__ = ["main"]


def main() -> None:
    """Runs the program."""
    # OpenCV's own words about damaged images; ours name the file.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")
    try:
        # Packages that bring verbs import from this one: the program is made when it runs.
        from engram.cli.app import main as run

        run()
    except KeyboardInterrupt:  # while the program starts; verbs have their own words
        print("engram: interrupted", file=sys.stderr)
        sys.exit(130)
