"""Tables in text files, as spreadsheets and laboratories write them."""
