"""The one error that users read."""


class HemislamError(Exception):
    """Something that the user gave cannot be used.

    The message is one sentence that says what is wrong, where, and what to do. The command line
    prints it and exits with code 2; the page shows it as a notification and the session goes on.
    """
