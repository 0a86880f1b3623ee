"""Tables that compare priors: one training run per row, measured once, written as Markdown, CSV and a picture."""

from agents.experiments.catalogue import list_rows, make_tables
from agents.experiments.precision_table import FACTORS
from agents.experiments.rows import PAPER, Entry, Row, Table
from agents.experiments.runner import run_tables
from agents.experiments.settings import ALL_TABLES, SIZES, Size, TablesConfig

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
