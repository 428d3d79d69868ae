"""Pictures of models and of closed loops, as plain values that any plotting library can draw.

One file per picture, a function of values; `drawing` makes a Matplotlib figure of it, the report
page a chart.
"""
