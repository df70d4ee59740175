"""openpi's websocket protocol for policies: the backend `openpi` is a client, the command
`policy openpi` a server.
"""
