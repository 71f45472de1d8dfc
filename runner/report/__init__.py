"""Reports of a run: `report.html`, and figures for papers and notebooks.

`write_report(folder)` writes the page; `runner.report.figures` has the figures one by one. The page needs the
extra `view` (plotly); figures as SVG need nothing beyond the base installation.
"""
