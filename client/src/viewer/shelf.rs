//! Where a native window keeps the bookmarks: `diamantina/bookmarks.json` in the user's folder of settings, by scene.

use super::bookmarks::{Bookmark, read};
use etcetera::BaseStrategy;
use serde_json::{Map, Value};
use std::io;
use std::path::PathBuf;

/// The file, and which scene's bookmarks in it.
#[derive(Debug)]
pub(super) struct Shelf {
    path: Option<PathBuf>,
    scene: String,
}

impl Shelf {
    /// That of a scene's address, in the folder that the system's customs name.
    pub(super) fn of(scene: &str) -> Self {
        let folder = etcetera::choose_base_strategy().ok().map(|customs| customs.config_dir());
        Self::at(folder.map(|folder| folder.join("diamantina").join("bookmarks.json")), scene)
    }

    fn at(path: Option<PathBuf>, scene: &str) -> Self {
        Self { path, scene: scene.to_owned() }
    }

    /// All scenes' bookmarks; none if there is no such file.
    fn all(&self) -> io::Result<Map<String, Value>> {
        let Some(path) = &self.path else { return Ok(Map::new()) };
        match std::fs::read(path) {
            Ok(bytes) => serde_json::from_slice(&bytes).map_err(|e| {
                let found =
                    format!("{}: expected bookmarks as JSON ({e}): mend it or move it away", path.display());
                io::Error::new(io::ErrorKind::InvalidData, found)
            }),
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(Map::new()),
            Err(e) => Err(io::Error::new(e.kind(), format!("{}: {e}", path.display()))),
        }
    }

    /// The scene's bookmarks.
    pub(super) fn recall(&self) -> io::Result<Vec<Bookmark>> {
        Ok(self.all()?.get(&self.scene).map(|list| read(&list.to_string())).unwrap_or_default())
    }

    /// Keeps the scene's bookmarks, as a text of [`super::Ask::Keep`]. Others' stay as they are; the file is
    /// replaced in one step.
    pub(super) fn keep(&self, text: &str) -> io::Result<()> {
        let mut all = self.all()?;
        let path = self.path.as_ref().ok_or_else(|| {
            io::Error::new(
                io::ErrorKind::NotFound,
                "there is no folder of settings: set XDG_CONFIG_HOME or HOME",
            )
        })?;
        all.insert(self.scene.clone(), serde_json::from_str(text)?);
        let told = |e: io::Error| io::Error::new(e.kind(), format!("{}: {e}", path.display()));
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder).map_err(told)?;
        }
        let new = path.with_extension(format!("{}.new", std::process::id()));
        std::fs::write(&new, serde_json::to_vec_pretty(&all)?).map_err(told)?;
        std::fs::rename(&new, path).map_err(told)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scenes_have_bookmarks_of_their_own() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("new").join("bookmarks.json");
        let [alps, moon] =
            ["http://a/scenes/alps", "http://a/scenes/moon"].map(|s| Shelf::at(Some(file.clone()), s));
        assert!(alps.recall().unwrap().is_empty());
        let one = |name: &str| Bookmark { name: name.into(), view: "1,2,3,4,-5".into() };
        let text = |list: &[Bookmark]| serde_json::to_string(list).unwrap();
        alps.keep(&text(&[one("summit"), one("lake")])).unwrap();
        moon.keep(&text(&[one("crater")])).unwrap();
        assert_eq!(alps.recall().unwrap(), [one("summit"), one("lake")]);
        assert_eq!(moon.recall().unwrap(), [one("crater")]);
        // What somebody else wrote there is not lost.
        std::fs::write(&file, "no JSON").unwrap();
        assert!(alps.keep("[]").unwrap_err().to_string().contains("bookmarks.json"));
        assert_eq!(std::fs::read(&file).unwrap(), b"no JSON");
        assert_eq!(std::fs::read_dir(file.parent().unwrap()).unwrap().count(), 1);
        assert!(Shelf::at(None, "x").keep("[]").is_err());
    }
}
