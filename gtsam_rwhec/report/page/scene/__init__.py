"""The rig in space: what is drawn (`model`, `directions`), for plotly (`traces`, `layout`) and on paper (`still`)."""
