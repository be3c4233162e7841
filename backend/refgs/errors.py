"""Errors that are the user's to mend."""


class InputError(Exception):
    """Something in the user's input is wrong.

    The message is one line for the artist: what is wrong, where, what to do. The command line prints it alone and ends
    with exit status 2; any other exception is our fault and ends with status 1 and a traceback in log.txt.
    """


class NoCameras(InputError):
    """A folder holds photos, but nothing that says where they were taken from: `refgs.capture.motion` can find it."""


class InputWarning(UserWarning):
    """Something in the user's input is wrong, and what is right of it was taken. One line, as of an InputError."""
