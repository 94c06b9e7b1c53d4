"""Figures of runs and results for a paper: PDF, SVG or PNG at the width of a column or a page."""
