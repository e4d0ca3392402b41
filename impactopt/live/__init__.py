"""A live look at a plan: a page on this machine whose sliders and hit point make new plans."""
