"""The steps of the pipeline, one module each, and the command line that lists them."""
