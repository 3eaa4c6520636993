"""The most expensive request of each route: what it costs the server, and how long others wait meanwhile."""
