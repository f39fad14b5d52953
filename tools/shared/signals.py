"""Tables that a run writes, as the Python module reads them."""
from pulmo.tables import columns, whole_rows  # noqa: F401: for the tools
