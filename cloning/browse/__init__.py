"""Browse: a page on this machine that shows recordings, and cuts stretches from them."""
