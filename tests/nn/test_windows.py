import jax
import numpy as np
import pytest

from anytouch_jax.nn.fields import windows

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(("side", "stride"), [(3, 1), (3, 2), (5, 2)])
@pytest.mark.parametrize(("height", "width"), [(7, 7), (8, 5), (1, 2)])
def test_a_product_with_windows_is_a_convolution(side, stride, height, width):
    x = RNG.standard_normal((2, height, width, 3)).astype("f4")
    kernel = RNG.standard_normal((side * side * 3, 4)).astype("f4")

    @jax.jit
    def run(x, kernel):
        around = [(side // 2, side // 2)] * 2
        wanted = jax.lax.conv_general_dilated(
            x, kernel.reshape(side, side, 3, 4), (stride, stride), around, dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        return windows(x, side, stride) @ kernel, wanted

    result, wanted = run(x, kernel)
    assert wanted.shape == (2, -(-height // stride), -(-width // stride), 4)
    np.testing.assert_allclose(result, wanted, atol=1e-5)
