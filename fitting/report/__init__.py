"""What all reports share: what a study says, words, tables, pages, colours.

A study makes a `Document` of its result; the terminal, Markdown, the page and notebooks render it.
`formatting` sets numbers, and tables as text that knows its cells, and names every number and its
unit. `pages` fills the templates of pages; `motion_data` puts clips into them. `style` is how plots
look, `guides` are the lists of parameters and keys.

Each study words and draws its own results, in its own folder of `fitting.studies`. Start with
`document`.
"""
