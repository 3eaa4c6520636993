"""The guide: the documents of `docs/` and generated references as a web site, which the server serves at /guide.

Needs the development dependencies (Sphinx, MyST, Furo); the server itself only delivers the files.
"""
