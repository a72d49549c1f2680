"""Reports: tables, pages, charts, videos."""
