"""The transport `stdio`: one client, which starts the server and communicates over its standard
streams.
"""
