"""The one root of every error that this product raises on purpose."""


class HilError(Exception):
    """Something is wrong that the user can mend; the message says what, where and how."""
