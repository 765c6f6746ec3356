"""Time series of episodes: record, write to files, plot, report.

``RecordSeries`` and ``RecordVectorSeries`` write down what environments do. ``TimeSeries`` is what
they have written. ``plot`` draws an episode, and ``write_report`` makes a page of HTML.
"""

from fmugym.series.plots import plot
from fmugym.series.recorder import RecordSeries, RecordVectorSeries
from fmugym.series.report import write_report
from fmugym.series.timeseries import TimeSeries

__all__ = ["RecordSeries", "RecordVectorSeries", "TimeSeries", "plot", "write_report"]
