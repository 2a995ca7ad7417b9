"""What the verb `new` writes besides packages: laws in other languages, drives from data sheets."""
