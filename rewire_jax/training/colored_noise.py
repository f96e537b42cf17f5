"""Gaussian noise with a coloured spectrum in time."""

import jax
import jax.numpy as jnp
import numpy as np


def colored(
    key: jax.Array, color: float, length: int, shape: tuple[int, ...]
) -> jax.Array:
    """Gaussian sequences `[length, *shape]` with power spectrum f^-color.

    The sequences are independent of each other. Every element is N(0, 1). The spectrum
    is flat below the frequency 1 / length, so the mean of a sequence varies too.
    (Timmer and Koenig 1995; Eberhard et al., ICLR 2023, who exclude the mean from the
    variance.)

    Args:
      key: a random key.
      color: 0 is white, 1 pink, 2 red.
      length: steps in time, at least 1.
      shape: shape of the array of sequences.
    """
    power = np.maximum(np.abs(np.fft.fftfreq(length)), 1 / length) ** -color
    gain = np.sqrt(power / power.mean())[: length // 2 + 1]
    gain = gain.reshape(-1, *(1 for _ in shape)).astype(np.float32)
    white = jax.random.normal(key, (length, *shape))
    # The coefficients of white noise are independent Gaussians; the gain scales them.
    return jnp.fft.irfft(jnp.fft.rfft(white, axis=0) * gain, length, axis=0)
