//! What an experiment hands in: tables and pictures, written as CSV, SVG or PNG, one HTML page and JSON.

use super::ExperimentError;
use serde::{Serialize, Serializer};
use std::fmt::Write as _;
use std::path::Path;

/// A table; all rows as wide as the columns.
#[derive(Debug, Serialize)]
pub struct Table {
    /// Name of its file, without `.csv`.
    pub name: String,
    /// What it shows, a sentence.
    pub caption: String,
    /// Headings with units.
    pub columns: Vec<String>,
    /// Cells as they are written; numbers in JSON where they are such.
    #[serde(serialize_with = "numbers")]
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// An empty table.
    #[must_use]
    pub fn new(name: &str, caption: &str, columns: &[&str]) -> Self {
        let columns = columns.iter().map(|c| (*c).to_owned()).collect();
        Self { name: name.to_owned(), caption: caption.to_owned(), columns, rows: Vec::new() }
    }

    /// Adds for each name a column of means and one of their standard deviations, which [`Report::html`] writes as one.
    pub fn add_means(&mut self, names: &[&str]) {
        self.columns.extend(names.iter().flat_map(|name| [(*name).to_owned(), format!("{name}{SPREAD}")]));
    }

    /// A row of this table, or its columns, with means and spreads joined by `between`, or spreads left out.
    fn joined(&self, cells: &[String], between: Option<&str>) -> Vec<String> {
        let mut joined: Vec<String> = Vec::with_capacity(cells.len());
        for (i, cell) in cells.iter().enumerate() {
            let is_spread =
                i > 0 && self.columns[i].strip_suffix(SPREAD) == Some(self.columns[i - 1].as_str());
            match (joined.last_mut(), between) {
                (Some(mean), Some(between)) if is_spread => *mean += &format!("{between}{cell}"),
                (Some(_), None) if is_spread => {}
                _ => joined.push(cell.clone()),
            }
        }
        joined
    }

    /// Adds a row.
    pub fn push(&mut self, cells: impl IntoIterator<Item = String>) {
        self.rows.push(cells.into_iter().collect());
    }

    /// Comma-separated, quoted where needed, a heading first (RFC 4180 with bare line feeds).
    #[must_use]
    pub fn csv(&self) -> String {
        let line = |cells: &[String]| {
            let quoted = cells.iter().map(|c| match c.contains([',', '"', '\n']) {
                true => format!("\"{}\"", c.replace('"', "\"\"")),
                false => c.clone(),
            });
            quoted.collect::<Vec<_>>().join(",") + "\n"
        };
        line(&self.columns) + &self.rows.iter().map(|row| line(row)).collect::<String>()
    }
}

/// What the name of a column of standard deviations ends with; that of their means stands before it.
const SPREAD: &str = " sd";

/// Cells with units or words stay text.
fn numbers<S: Serializer>(rows: &[Vec<String>], serializer: S) -> Result<S::Ok, S::Error> {
    let value = |cell: &String| match cell.parse::<serde_json::Number>() {
        Ok(number) => serde_json::Value::Number(number),
        Err(_) => serde_json::Value::String(cell.clone()),
    };
    serializer.collect_seq(rows.iter().map(|row| row.iter().map(value).collect::<Vec<_>>()))
}

/// A picture as its file.
#[derive(Debug, Serialize)]
pub struct Picture {
    /// Name of its file, with the ending.
    pub file: String,
    /// What it shows, a sentence.
    pub caption: String,
    /// The file.
    #[serde(skip)]
    pub bytes: Vec<u8>,
}

/// Makes a folder, if need be, and sees whether files can be made in it: before work whose results it is to hold. Returns
/// whether it was made.
///
/// # Errors
/// When they cannot.
pub fn prepare(folder: &Path) -> Result<bool, ExperimentError> {
    let is_new = !folder.exists();
    let made = std::fs::create_dir_all(folder).and_then(|()| tempfile::tempfile_in(folder));
    made.map(|_| is_new).map_err(|source| ExperimentError::Write { path: folder.to_owned(), source })
}

/// All that an experiment found.
#[derive(Debug, Serialize)]
pub struct Report {
    /// A heading.
    pub title: String,
    /// What was done, with what, in sentences.
    pub notes: Vec<String>,
    /// Figures.
    pub tables: Vec<Table>,
    /// Plots and views.
    pub pictures: Vec<Picture>,
}

impl Report {
    /// Writes the tables, the pictures and `report.html` into a folder, which is made if need be.
    ///
    /// # Errors
    /// When the folder cannot be written.
    pub fn write(&self, folder: &Path) -> Result<(), ExperimentError> {
        let save = |name: &str, bytes: &[u8]| {
            let path = folder.join(name);
            std::fs::write(&path, bytes).map_err(|source| ExperimentError::Write { path, source })
        };
        prepare(folder)?;
        for table in &self.tables {
            save(&format!("{}.csv", table.name), table.csv().as_bytes())?;
        }
        for picture in &self.pictures {
            save(&picture.file, &picture.bytes)?;
        }
        save("report.html", self.html().as_bytes())
    }

    /// Tables and pictures in a folder that this report does not have: those of another run.
    #[must_use]
    pub fn others(&self, folder: &Path) -> Vec<String> {
        let tables = self.tables.iter().map(|table| format!("{}.csv", table.name));
        let own: Vec<String> = tables.chain(self.pictures.iter().map(|p| p.file.clone())).collect();
        let is_one = |name: &String| {
            let ending = Path::new(name).extension().and_then(|e| e.to_str());
            matches!(ending, Some("csv" | "svg" | "png")) && !own.contains(name)
        };
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
        let mut names: Vec<String> =
            entries.filter_map(|entry| entry.file_name().into_string().ok()).filter(is_one).collect();
        names.sort_unstable();
        names
    }

    /// One page that needs nothing but the pictures beside it.
    #[must_use]
    pub fn html(&self) -> String {
        let mut page = format!(
            "<!doctype html><html lang=\"en\"><meta charset=\"utf-8\"><title>{0}</title><style>{STYLE}</style><h1>{0}</h1>\n",
            escaped(&self.title)
        );
        // Writing to a string does not fail.
        for note in &self.notes {
            let _ = writeln!(page, "<p>{}</p>", escaped(note));
        }
        for picture in &self.pictures {
            let (file, caption) = (escaped(&picture.file), escaped(&picture.caption));
            let _ = writeln!(
                page,
                "<figure><img src=\"{file}\" alt=\"{caption}\"><figcaption>{caption}</figcaption></figure>"
            );
        }
        for table in &self.tables {
            let cells = |cells: &[String], tag: &str| {
                cells.iter().map(|c| format!("<{tag}>{}</{tag}>", escaped(c))).collect::<String>()
            };
            let _ = writeln!(
                page,
                "<div class=\"table\"><table><caption>{} (<a href=\"{1}.csv\">{1}.csv</a>)</caption><tr>{2}</tr>",
                escaped(&table.caption),
                escaped(&table.name),
                cells(&table.joined(&table.columns, None), "th")
            );
            for row in &table.rows {
                let _ = writeln!(page, "<tr>{}</tr>", cells(&table.joined(row, Some(" ± ")), "td"));
            }
            page.push_str("</table></div>\n");
        }
        page
    }
}

const STYLE: &str = "body{font:16px/1.5 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem;color:#222}\
table{border-collapse:collapse;font-size:.85rem;font-variant-numeric:tabular-nums}caption{text-align:left;padding:.5rem 0}\
th,td{border-bottom:1px solid #ddd;padding:.2rem .6rem;text-align:right}th{border-bottom:2px solid #888;vertical-align:bottom}\
.table{overflow-x:auto;margin:2rem 0}figure{margin:2rem 0}img{max-width:100%}figcaption,caption{color:#555}";

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_and_spreads_are_numbers_in_files_and_one_cell_on_a_page() {
        let mut table = Table::new("t", "means", &["strategy"]);
        table.add_means(&["points", "triangles"]);
        table.push(["top-down", "7.5", "0.5", "12.0", "3.0"].map(str::to_owned));
        assert_eq!(
            table.csv(),
            "strategy,points,points sd,triangles,triangles sd\ntop-down,7.5,0.5,12.0,3.0\n"
        );
        let json = serde_json::to_value(&table).unwrap();
        assert_eq!(json["rows"], serde_json::json!([["top-down", 7.5, 0.5, 12.0, 3.0]]));
        let report = Report { title: String::new(), notes: vec![], tables: vec![table], pictures: vec![] };
        let page = report.html();
        assert!(page.contains("<th>strategy</th><th>points</th><th>triangles</th></tr>"), "{page}");
        assert!(page.contains("<td>top-down</td><td>7.5 ± 0.5</td><td>12.0 ± 3.0</td></tr>"), "{page}");
    }

    #[test]
    fn tables_are_quoted_and_pages_escaped() {
        let mut table = Table::new("t", "a <b>", &["x, y", "z"]);
        table.push(["1".to_owned(), "say \"so\"".to_owned()]);
        assert_eq!(table.csv(), "\"x, y\",z\n1,\"say \"\"so\"\"\"\n");
        let json = serde_json::to_value(&table).unwrap();
        assert_eq!(json["rows"], serde_json::json!([[1, "say \"so\""]]));
        let report =
            Report { title: "a & b".to_owned(), notes: vec![], tables: vec![table], pictures: vec![] };
        assert!(report.html().contains("a &amp; b") && report.html().contains("a &lt;b&gt;"));
        let folder = tempfile::tempdir().unwrap();
        report.write(&folder.path().join("new")).unwrap();
        assert!(report.others(&folder.path().join("new")).is_empty());
        std::fs::write(folder.path().join("new/old.csv"), "").unwrap();
        assert_eq!(report.others(&folder.path().join("new")), ["old.csv"]);
        assert!(folder.path().join("new/t.csv").exists() && folder.path().join("new/report.html").exists());
    }
}
