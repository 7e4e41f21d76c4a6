"""Which panels the page has, and where."""

import rerun.blueprint as rrb

TIMELINE = "measured"
SHOWN = 40.0  # s of the plots
# Metres around the car from the driver's seat: 5 s ahead at town speed, and some of where it came from.
AHEAD, BEHIND, ASIDE = 44.0, 16.0, 34.0
AROUND, GRID = 50.0, 20.0  # metres shown around the car on the map, and between the lines of its grid
PLOTS = {
    "lateral": "lateral error of the 5 s just over, m (+ predicted left)",
    "longitudinal": "longitudinal error, m (+ predicted ahead)",
    "steering": "road wheel angle, deg (left +)",
    "speed": "speed, m/s",
    "lateral_acceleration": "lateral acceleration v_x r, m/s² (left +)",
}
PAPER = (255, 255, 255)


def blueprint() -> rrb.Blueprint:
    now = rrb.TimeRangeBoundary.cursor_relative
    window = rrb.VisibleTimeRange(TIMELINE, start=now(seconds=-SHOWN), end=now())

    def plot(name: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(origin=f"plots/{name}", name=PLOTS[name], time_ranges=[window],
                                  plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop))

    ahead = rrb.Spatial2DView(
        origin="ahead", name="From the driver's seat (heading up, 10 m rings)", background=PAPER,
        visual_bounds=rrb.VisualBounds2D(x_range=[-ASIDE, ASIDE], y_range=[-AHEAD, BEHIND]))
    around = rrb.Spatial2DView(
        origin="map", name=f"Map (north up, {GRID:.0f} m grid)", background=PAPER,
        visual_bounds=rrb.VisualBounds2D(x_range=[-AROUND, AROUND], y_range=[-AROUND, AROUND]))
    passenger = rrb.TextDocumentView(origin="passenger", name="Now")
    words = rrb.TextDocumentView(origin="words", name="Errors so far, and health")
    # A Tabs container shows its first; the others are a click away.
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(ahead, rrb.Tabs(plot("steering"), plot("speed"), plot("lateral_acceleration")),
                         row_shares=[3, 1]),
            rrb.Vertical(rrb.Horizontal(around, passenger, column_shares=[1, 1.6]), words,
                         rrb.Tabs(plot("lateral"), plot("longitudinal")),
                         row_shares=[1.9, 1.1, 1]),
            column_shares=[1, 1.35],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
    )
