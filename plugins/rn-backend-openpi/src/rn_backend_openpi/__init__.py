"""openpi's websocket protocol for policies: the backend `openpi` is a client, the command
`openpi-server` a server.
"""
