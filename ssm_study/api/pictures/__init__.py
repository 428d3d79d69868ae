"""Pictures of models and closed loops as plain data, which any plotting library can draw.

One file per picture, a function of values; `drawing` makes a Matplotlib figure of it, the report
page a chart.
"""
