"""Where a page gets its data, and the tool calls of its buttons.

The sources here are in the server's process; others are in `rn_view_attached` and
`rn_view_recorded`.
"""
