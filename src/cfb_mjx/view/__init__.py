"""Figures and pages. Importing this package loads numpy only; drawing functions load matplotlib when called."""

from cfb_mjx.view.page import Section, html_page
from cfb_mjx.view.prediction import prediction_figure
from cfb_mjx.view.spread import spread_figure

__all__ = ["Section", "html_page", "prediction_figure", "spread_figure"]
