"""Workers: they merge hand-ins and make downloads."""
