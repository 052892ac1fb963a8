"""Sessions and closures in other programs' formats."""

from semloc_logs.exports.exporting import FORMATS, POINT_FORMATS, Selection, export

__all__ = ["FORMATS", "POINT_FORMATS", "Selection", "export"]
