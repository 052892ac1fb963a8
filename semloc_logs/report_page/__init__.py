"""The report of a workspace as one HTML page: its data, its pictures, and the page itself."""
