"""`waymark demo`: from plates and magnets on a lane to decoded drives, over HTTP, in a table each."""

from app.demo.run import run_demo

__all__ = ["run_demo"]
