"""What the documentation's site has beside docs/*.md: pages made from code and recorded results.

``hooks`` hands them to MkDocs; the rest is pure functions from files to Markdown, without MkDocs.
"""
