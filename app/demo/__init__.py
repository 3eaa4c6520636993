"""`waymark demo`: from surveyed plates on a real lane to a decoded drive, over HTTP, in one table."""

from app.demo.run import run_demo

__all__ = ["run_demo"]
