import pytest

from tests import compiled


@pytest.fixture(autouse=True, scope="module")
def compiled_programs(tmp_path_factory):
    """Compile each program of these tests once, as the commands do."""
    with compiled.once(tmp_path_factory.getbasetemp() / "compiled"):
        yield
