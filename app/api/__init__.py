"""HTTP: thin routers, problem documents, authentication and limits."""
