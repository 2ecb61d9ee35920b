"""What a peer says when it cannot be run here."""


class Unavailable(Exception):
    """The message says what is missing."""
