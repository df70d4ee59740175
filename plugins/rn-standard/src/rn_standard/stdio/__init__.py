"""The transport `stdio`: one client, which starts the server and talks to it over its standard
streams.
"""
