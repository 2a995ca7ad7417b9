"""What the verb `new` writes: a controller in place of another, laws in other languages, drives from data sheets."""
