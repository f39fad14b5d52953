"""Runs of pulmo in Python."""
from .errors import Missing, PulmoError, RunFailed  # noqa: F401
