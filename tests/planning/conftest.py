"""Fixtures of the tests of magnet layouts."""

from tests.encoders.magnet.bend import *  # noqa: F403
