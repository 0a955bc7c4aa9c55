"""The error for invalid input and the warning for unusual input, each one sentence that names the file."""


class CfbError(Exception):
    """Invalid input or an unusable environment. The command line prints the message and exits with status 2."""


class CfbWarning(UserWarning):
    """Valid but unusual input. The command line prints the message, one sentence, once and continues."""
