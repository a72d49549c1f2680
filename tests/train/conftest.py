import pytest

from tests import compiled
from tests.train.fakes import fake_model

__all__ = ["fake_model"]


@pytest.fixture(autouse=True, scope="module")
def compiled_programs(tmp_path_factory):
    """Compile each program of these tests once, as train.py does from one start to the next."""
    with compiled.once(tmp_path_factory.getbasetemp() / "compiled"):
        yield
