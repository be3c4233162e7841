"""Define the error for problems that the artist can fix."""


class InputError(Exception):
    """Report a problem that the artist can fix, in one line: what is wrong, where, and what to do.

    Operators show the line in Blender. Programs without a window print it to stderr.
    """


def missing_module(error: ModuleNotFoundError) -> str:
    """Return a message for the artist that Blender's Python lacks a package."""
    return f"Blender's Python lacks {error.name}: install it (on Debian, python3-{error.name})"
