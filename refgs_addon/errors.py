"""Errors that are the artist's to mend."""


class InputError(Exception):
    """One line for the artist: what is wrong, where, what to do. Operators report it; the command line prints it."""
