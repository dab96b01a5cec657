"""The report on paper where the system can print, and a clear line where it cannot."""

from __future__ import annotations

import sys

from Workstation.report_pdf import write_report_pdf


class WithoutPango:
    """Stands where WeasyPrint does on a system without Pango."""

    def __getattr__(self, name: str) -> object:
        raise OSError("cannot load library 'libpango-1.0-0'")


def test_without_pango_one_line_tells_what_to_install_and_no_earlier_pdf_stays(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "weasyprint", WithoutPango())
    html, pdf = tmp_path / "report.html", tmp_path / "report.pdf"
    html.write_text("<p>this result</p>")
    pdf.write_bytes(b"an earlier result")
    assert not write_report_pdf(html, pdf)
    assert not pdf.exists()
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1
    assert "apt-get install libpangoft2-1.0-0" in said
