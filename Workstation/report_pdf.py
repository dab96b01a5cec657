"""The report on paper: report.pdf, made of report.html."""

from __future__ import annotations

import sys
from pathlib import Path

from CranioNavLib.files import written_whole

NEEDS = "libpangoft2-1.0-0 libharfbuzz-subset0"  # Debian packages WeasyPrint loads at run time


def write_report_pdf(html: Path, pdf: Path) -> bool:
    """Print the self-contained `html` to `pdf` (A4, pages numbered); say so on stderr where the system cannot.

    Returns
    -------
    whether `pdf` was written; where it was not, no earlier one is left that could pass for this result's
    """
    try:
        from weasyprint import HTML
    except OSError as error:  # its wheel brings no Pango: that is the system's
        pdf.unlink(missing_ok=True)
        print(f"cranionav: {pdf.name} was not written ({error}); please type: sudo apt-get install {NEEDS}", file=sys.stderr)
        return False
    with written_whole(pdf) as temporary:
        HTML(filename=html).write_pdf(temporary)
    return True
