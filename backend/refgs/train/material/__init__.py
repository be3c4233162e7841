"""Tell metal from paint by what the photos show of each surfel."""
