"""Sessions and closures in other programs' formats."""

from semloc_logs.exports.export import FORMATS, POINT_FORMATS, Selection, export

__all__ = ["FORMATS", "POINT_FORMATS", "Selection", "export"]
