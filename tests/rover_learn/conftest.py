import pytest

from tests.helpers.policies import of_a_cars_size


@pytest.fixture(scope="session")
def car_policy(tmp_path_factory):
    """A trainer's file of a tiny policy that plans a car's actions."""
    return of_a_cars_size(tmp_path_factory.mktemp("policy") / "best_model.pth")


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """Each test has a cache of its own."""
    monkeypatch.setenv("ROVER_CACHE", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def module_cache(tmp_path_factory):
    """And so has what a module's tests share; a folder for it."""
    folder = tmp_path_factory.mktemp("shared")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROVER_CACHE", str(folder / "cache"))
        yield folder
