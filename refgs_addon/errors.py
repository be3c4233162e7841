"""Errors that the artist can fix."""


class InputError(Exception):
    """Report one line to the artist: what is wrong, where, what to do. Operators show it, the command line prints it."""
