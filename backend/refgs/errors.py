"""Define errors and warnings about the user's input."""


class InputError(Exception):
    """Wrong input by the user.

    The message is one line for the artist: what is wrong, where, what to do. The command line prints it alone and ends
    with exit status 2. Any other exception is our fault: it ends with status 1 and a traceback in log.txt.
    """


class NoCameras(InputError):
    """Folder with photos but without cameras. `refgs.capture.motion` can find them."""


class InputWarning(UserWarning):
    """Partly wrong input: the right part was used. The message is one line, as in an InputError."""
