"""How well the past is judged: labelled recordings, and what the questions say of them."""
