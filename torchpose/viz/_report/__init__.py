"""Write the report of a tracked video: one self-contained HTML page that needs no network."""

from torchpose.viz._report.page import write_report

__all__ = ["write_report"]
