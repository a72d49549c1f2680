import pytest
from training_fakes import fake_model

from tests import compiled

__all__ = ["fake_model"]


@pytest.fixture(autouse=True, scope="module")
def compiled_programs(tmp_path_factory):
    """Compile each program of these tests once, as train.py does from one start to the next."""
    with compiled.once(tmp_path_factory.getbasetemp() / "compiled"):
        yield
