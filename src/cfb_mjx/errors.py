"""The one exception a user's mistake raises: one sentence that names the file and says what to do."""


class CfbError(Exception):
    """Bad input or an unusable environment. The command line prints the message and exits with status 2."""
