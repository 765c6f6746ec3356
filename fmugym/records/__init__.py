"""Records of episodes: time series, plots, reports, scores, recordings, datasets, plant logs.

``RecordSeries`` and ``RecordVectorSeries`` write down what environments do. ``TimeSeries`` is what
they have written. ``plot`` draws an episode, and ``write_report`` makes a page of HTML.
"""

from typing import TYPE_CHECKING

from fmugym.extras import lazily

if TYPE_CHECKING:
    from fmugym.records.html_report import write_report
    from fmugym.records.plots import plot
    from fmugym.records.series_recorder import RecordSeries, RecordVectorSeries
    from fmugym.records.time_series import TimeSeries

__all__ = ["RecordSeries", "RecordVectorSeries", "TimeSeries", "plot", "write_report"]

__getattr__ = lazily(
    __name__,
    {
        "RecordSeries": "fmugym.records.series_recorder",
        "RecordVectorSeries": "fmugym.records.series_recorder",
        "TimeSeries": "fmugym.records.time_series",
        "plot": "fmugym.records.plots",
        "write_report": "fmugym.records.html_report",
    },
)
