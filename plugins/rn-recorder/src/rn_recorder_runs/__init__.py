"""Runs on disk: the recorder's process, the files it writes, and what is made of them."""
