"""Live sources of uploads: messages of a broker are collected, stored on disk and sent to the server."""
