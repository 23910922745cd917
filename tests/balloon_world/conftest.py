import pytest


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory):
    """A cache of the tests' own, so that they neither find nor leave anything in the user's."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROVER_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session")
def recorded(cache, tmp_path_factory):
    """Five drives of the expert."""
    from balloon_world.record import record_episodes

    return record_episodes(tmp_path_factory.mktemp("data") / "episodes", count=5, seed=3)
