"""What every route shares: dependencies, middleware, permissions, problem documents, limits."""
