import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache
from training_fakes import fake_model

__all__ = ["fake_model"]


@pytest.fixture(autouse=True, scope="module")
def compiled_programs(tmp_path_factory):
    """Compile each program of these tests once, as train.py does from one start to the next."""
    folder = tmp_path_factory.getbasetemp() / "compiled"
    options = {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": -1,
    }
    before = {name: getattr(jax.config, name) for name in options}
    for name, value in options.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()
