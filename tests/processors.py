"""How this machine is made to round as another one does; as a script, the AVX-512 features that NumPy has found here (.ci/run)."""

import sys

import numpy as np


def vector_code() -> list[str]:
    """Return the names of the processor's features that NumPy uses here beyond its baseline."""
    return list(np.show_config(mode="dicts")["SIMD Extensions"].get("found", []))


ANOTHER_PROCESSOR = {"NPY_DISABLE_CPU_FEATURES": " ".join(vector_code()), "OPENBLAS_CORETYPE": "Haswell"}
"""Environment of a process whose NumPy takes sines, exponentials and logarithms from the C library."""


if __name__ == "__main__":
    sys.stdout.write(" ".join(name for name in vector_code() if name.startswith("AVX512") or name == "X86_V4"))
