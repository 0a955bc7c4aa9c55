"""What a user's mistake raises, and what unusual input warns with: one sentence that names the file."""


class CfbError(Exception):
    """Bad input or an unusable environment. The command line prints the message and exits with status 2."""


class CfbWarning(UserWarning):
    """Input that can be meant but surely is unusual: one sentence. The command line prints it once and goes on."""
