"""Addresses of the web pages: each is answered by the same HTML file."""

PAGES = (
    "/",
    "/markers",
    "/markers/{marker}",
    "/roads",
    "/roads/new",
    "/roads/{road}",
    "/roads/lanes/{alignment}",
    "/plans",
    "/plans/new",
    "/plans/compare",
    "/plans/{plan}",
    "/decode",
    "/decodes",
    "/decodes/{decode}",
    "/studio/plates",
    "/studio/magnets",
    "/studio/cerpms",
    "/imports",
    "/imports/{import_job}",
    "/operations/{section}",
    "/operations/{section}/{item}",
    "/sign-in",
)
"""Addresses of the web pages. static/app/routes.js names the module that draws each; a test compares the two."""
