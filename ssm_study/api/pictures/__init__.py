"""Pictures of models and of closed loops, as values that any renderer can draw.

One file per picture, a function of values; `drawing` makes a Matplotlib figure of it, the report
page a chart.
"""
