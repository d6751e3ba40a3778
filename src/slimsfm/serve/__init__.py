"""Localize images that come over the network: an HTTP API, tracking by WebSocket, a page for phones.

Needs the packages of the extra `serve`; the client needs httpx alone.
"""
