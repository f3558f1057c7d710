"""Pictures of matplotlib's figures."""

import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # slow to import, and not needed without a figure
    from matplotlib.figure import Figure


def png(figure: "Figure", dpi: int) -> bytes:
    """Return a figure as a PNG of so many dots per inch."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=dpi)
    return file.getvalue()
