import pytest


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """Five drives of the expert."""
    from balloon_world.record import record_episodes

    return record_episodes(tmp_path_factory.mktemp("data") / "episodes", count=5, seed=3)
