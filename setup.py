"""The packages of the wheel: one at the top, `app`, with the folders `migrations` and `static` inside it."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["app", "app.*"]), "app.migrations", "app.migrations.versions", "app.static"],
    package_dir={"app.migrations": "migrations", "app.static": "static"},
)
