"""Define the error for problems that the artist can fix."""


class InputError(Exception):
    """Report a problem that the artist can fix, in one line: what is wrong, where, and what to do.

    Operators show the line in Blender. Programs without a window print it to stderr.
    """
