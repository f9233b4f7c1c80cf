"""Detection of contacts and the list that holds them."""
