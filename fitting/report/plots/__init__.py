"""Pictures: each public function draws one matplotlib figure and returns it.

`style` holds what they share: colours, fonts, time axes, and saving a figure to a file.
"""
