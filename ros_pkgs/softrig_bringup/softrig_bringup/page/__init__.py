"""Parts of pages: HTML, diagrams, citations, numbers as text."""
