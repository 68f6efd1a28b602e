import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.export.packages import needed


@pytest.mark.parametrize(
    "error",
    [
        ModuleNotFoundError("No module named 'flatbuffers'", name="flatbuffers"),
        ImportError("Please install 'flatbuffers' in order to use Exported serialization"),
    ],
)
def test_a_missing_package_is_named_with_the_extra_that_brings_it(error):
    says = r"flatbuffers.*: pip install .anytouch_jax\[export\]"
    with pytest.raises(UserError, match=says), needed("anytouch_jax[export]"):
        raise error
