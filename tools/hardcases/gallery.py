"""All hard cases, in the order of the page."""
from . import laws, loads, discretisation, pores, states, contact, fuzz  # noqa: F401: they register their cases
from .lab import CASES, run_case  # noqa: F401
