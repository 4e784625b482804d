"""From the store to curves, statistics, figures and pages; reads the store and its artifacts only.

Nothing is imported here: pandas and matplotlib load when a report is made, not before.
"""
