"""Shared by all tests: no test reads or fills the user's cache."""

import pytest


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory: pytest.TempPathFactory):
    """A cache of the session, so that probing the renderer happens once, not once a test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OPTSIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
