"""Tables of text: lines to cells, the begin of a table, and its frames."""
