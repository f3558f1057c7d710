"""Pictures of matplotlib's figures."""

import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # slow to import, and not needed without a figure
    from matplotlib.figure import Figure


def png(figure: "Figure", dpi: int, title: str = "") -> bytes:
    """Return a figure as a PNG of so many dots per inch; its title may name a file with undecodable bytes or $."""
    if title:
        figure.suptitle(title.encode(errors="replace").decode(), fontsize=11, parse_math=False)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=dpi)
    return file.getvalue()
