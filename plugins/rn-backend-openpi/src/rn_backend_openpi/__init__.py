"""openpi's websocket for policies: the backend `openpi` asks a server, the command `openpi-server`
is one.
"""
