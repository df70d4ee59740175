"""HTTP and websockets of the view: the server of all pages, requests, and access."""
