"""Reports of a run: `report.html`, and figures for papers and notebooks.

`write_report(folder)` writes the page; `runner.report.figures` has the figures one by one, `runner.report.latex` the
tables for a paper. The page needs the extra `view` (plotly).
"""
