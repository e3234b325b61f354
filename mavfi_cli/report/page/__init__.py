"""The report as one HTML file: `render` fills page.html, with page.css and the charts inside."""
