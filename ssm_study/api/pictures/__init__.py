"""Pictures of a model and of a loop: what each shows, apart from what draws it.

One file per picture, a function of values; `drawing` makes a Matplotlib figure of it, the report
page a chart.
"""
