"""What all reports share: words, tables, pages, colours.

`formatting` sets numbers, and tables as text that knows its cells, and names every number and its
unit. `pages` fills the template of a page, of sections of text, tables and pictures; `motion_data`
puts clips into it. `style` is how plots look, `guides` are the lists of parameters and keys.

Each study words and draws its own results, in its own folder of `fitting.studies`. Start with
`formatting`.
"""
