"""From run directories to figures and tables with the paper's numbers beside them."""

import contextlib
import os
import sys

# A notebook's MPLBACKEND reaches the commands that it starts, whose installation may lack that
# backend: matplotlib would refuse to be imported. Figures are drawn without any (`plots.py`).
if "matplotlib" not in sys.modules and "MPLBACKEND" in os.environ:
    backend = os.environ.pop("MPLBACKEND")
    import matplotlib

    os.environ["MPLBACKEND"] = backend
    with contextlib.suppress(ValueError):
        matplotlib.rcParams["backend"] = backend
