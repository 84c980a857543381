"""How fast it is, beside what, and beside what the core could do: for mmwave-loc speed."""
