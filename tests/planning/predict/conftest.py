"""Plans that the proofs use too."""

from __future__ import annotations

from tests.planning.proof.conftest import cerpms, plates

__all__ = ["cerpms", "plates"]
