"""The verb `new`: a controller in place of another, controllers in other languages, drives from data sheets."""
