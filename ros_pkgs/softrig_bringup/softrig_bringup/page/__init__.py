"""Pages in parts: HTML, diagrams, citations, words of numbers."""
