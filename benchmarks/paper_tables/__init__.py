"""Tables that compare priors: one training run per row, measured once, written as Markdown, CSV and a picture."""

from benchmarks.paper_tables.catalogue import list_rows, make_tables
from benchmarks.paper_tables.precision_table import FACTORS
from benchmarks.paper_tables.rows import PAPER, Entry, Row, Table
from benchmarks.paper_tables.runner import run_tables
from benchmarks.paper_tables.settings import ALL_TABLES, SIZES, Size, TablesConfig

__all__ = [
    "ALL_TABLES",
    "FACTORS",
    "PAPER",
    "SIZES",
    "Entry",
    "Row",
    "Size",
    "Table",
    "TablesConfig",
    "list_rows",
    "make_tables",
    "run_tables",
]
