//! The entries themselves, in a file of SQLite.
//!
//! ```text
//! FOLDER/fetched-1-N.sqlite      format 1, the N-th file; beside it what SQLite writes for itself (-wal, -shm)
//!   place    id, origin, scene, version, stale
//!   entry    id, place, name, rank, used, checksum, data
//!   session  count
//! ```
//!
//! Several programs may use one file at once: SQLite sees to that. A file that turns out to be damaged is removed and never
//! used again, whoever still has it open: the next one has another number.
//!
//! **What is forgotten first**: versions that are no longer current; then what no session has used for the longest; of the
//! same session the finest. A session uses the ancestors of whatever it uses, since nothing can be decoded without
//! them: so no diamond is kept longer than what it depends on.

use super::DiskError;
use rusqlite::{Connection, ErrorCode, OpenFlags, OptionalExtension as _, TransactionBehavior, params};
use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Of file names: what is of another format stays, and is not read.
const FORMAT: u32 = 1;

/// Bytes of a page of the file: a dozen typical payloads.
const PAGE_BYTES: u64 = 8 << 10;

/// What of the limit is left to the log of what is being written, which SQLite empties at 4 MiB: a round is some 3 MiB at most.
pub(super) const LOG_BYTES: u64 = 8 << 20;

/// How long another program's writing is waited for; it takes milliseconds.
const BUSY: Duration = Duration::from_millis(100);

/// The same for opening, which happens once.
const BUSY_OPENING: Duration = Duration::from_secs(5);

/// Entries that are forgotten at once.
const EVICTED: i64 = 256;

/// What an entry takes beside its data and its name, about: two keys and a row.
const ENTRY_BYTES: u64 = 120;

const SCHEMA: &str = "
    CREATE TABLE IF NOT EXISTS place (
        id INTEGER PRIMARY KEY, origin BLOB NOT NULL, scene TEXT NOT NULL, version TEXT NOT NULL,
        stale INTEGER NOT NULL DEFAULT 0, UNIQUE (origin, scene, version));
    CREATE TABLE IF NOT EXISTS entry (
        id INTEGER PRIMARY KEY, place INTEGER NOT NULL, name TEXT NOT NULL, rank INTEGER NOT NULL,
        used INTEGER NOT NULL, checksum BLOB NOT NULL, data BLOB NOT NULL, UNIQUE (place, name));
    CREATE INDEX IF NOT EXISTS entry_by_use ON entry (used, rank DESC);
    CREATE TABLE IF NOT EXISTS session (count INTEGER NOT NULL);
    INSERT INTO session SELECT 0 WHERE NOT EXISTS (SELECT 1 FROM session);";

/// Who sees an entry: a hash of the server's address and the token.
pub(super) type Origin = [u8; 16];

/// An entry's name: by whom it is seen, and its route.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Key {
    pub(super) origin: Origin,
    pub(super) route: String,
}

impl Key {
    /// The scene, the version and the rest of the route; each may be empty.
    fn parts(&self) -> [&str; 3] {
        let rest = self.route.strip_prefix("/scenes").unwrap_or(&self.route).trim_start_matches('/');
        let mut parts = rest.splitn(3, '/').map(Some).chain(std::iter::repeat(None));
        std::array::from_fn(|_| parts.next().flatten().unwrap_or_default())
    }

    /// What an entry of this name and with this data has as its checksum.
    fn checksum(&self, data: &[u8]) -> [u8; 8] {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&self.origin).update(self.route.as_bytes()).update(&[0]).update(data);
        let mut checksum = [0; 8];
        checksum.copy_from_slice(&hasher.finalize().as_bytes()[..8]);
        checksum
    }
}

/// What is written in one go.
#[derive(Debug, Default)]
pub(super) struct Round {
    /// With their ranks.
    pub(super) put: HashMap<Key, (u32, bytes::Bytes)>,
    pub(super) put_bytes: u64,
    /// Entries that were read, and were used in no round of this session yet.
    pub(super) used: Vec<i64>,
    pub(super) forgotten: Vec<Key>,
}

impl Round {
    pub(super) fn is_empty(&self) -> bool {
        self.put.is_empty() && self.used.is_empty() && self.forgotten.is_empty()
    }
}

/// What was found of an entry.
#[derive(Debug)]
pub(super) enum Found {
    /// Its data, and its number if this session uses it for the first time.
    Good(Vec<u8>, Option<i64>),
    /// It is there, and not what was put there.
    Damaged,
    Nothing,
}

/// Why something could not be read or written.
#[derive(Debug)]
pub(super) enum Trouble {
    /// Another program is writing: try again.
    Busy,
    /// The file is damaged.
    Damaged(String),
    /// The disk does not do it.
    Disk(String),
}

impl From<rusqlite::Error> for Trouble {
    fn from(error: rusqlite::Error) -> Self {
        match error.sqlite_error_code() {
            Some(ErrorCode::DatabaseBusy | ErrorCode::DatabaseLocked) => Self::Busy,
            Some(ErrorCode::DatabaseCorrupt | ErrorCode::NotADatabase) => Self::Damaged(error.to_string()),
            // Tables of ours with other columns.
            None | Some(ErrorCode::Unknown | ErrorCode::ConstraintViolation | ErrorCode::TypeMismatch) => {
                Self::Damaged(error.to_string())
            }
            Some(_) => Self::Disk(error.to_string()),
        }
    }
}

/// The file.
#[derive(Debug)]
pub(super) struct Entries {
    folder: PathBuf,
    number: u32,
    connection: Connection,
    /// Bytes that the file may have.
    limit: u64,
    session: i64,
    is_writable: bool,
    places: HashMap<(Origin, String, String), i64>,
}

impl Entries {
    /// Opens the file of a folder, which is made if need be; one that may not be written is read. Waits for the disk.
    pub(super) fn open(folder: &Path, limit: u64) -> Result<Self, DiskError> {
        let failed = |reason: String| DiskError::Folder { folder: folder.to_owned(), reason };
        let made = make_folder(folder);
        let number = numbers(folder).max().unwrap_or(1);
        let limit = limit.saturating_sub(LOG_BYTES);
        if let Err(error) = made {
            return Err(failed(error.to_string()));
        }
        match Self::at(folder, number, limit) {
            Ok(entries) => Ok(entries),
            Err(Trouble::Damaged(reason)) => {
                tracing::debug!(reason, "a damaged disk cache begins anew");
                remove(folder, number);
                Self::at(folder, number + 1, limit).map_err(|e| failed(said(e)))
            }
            Err(trouble) => Self::reading(folder, number).map_err(|_| failed(said(trouble))),
        }
    }

    fn at(folder: &Path, number: u32, limit: u64) -> Result<Self, Trouble> {
        let flags = OpenFlags::SQLITE_OPEN_READ_WRITE
            | OpenFlags::SQLITE_OPEN_CREATE
            | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let mut connection = Connection::open_with_flags(path(folder, number), flags)?;
        connection.busy_timeout(BUSY_OPENING)?;
        let pages = limit / PAGE_BYTES;
        // The first two count for a new file alone. Nothing is synced but the log before it is emptied: a loss of power
        // costs the last rounds, not the file.
        let settings = format!(
            "PRAGMA page_size = {PAGE_BYTES}; PRAGMA auto_vacuum = INCREMENTAL; PRAGMA journal_mode = WAL;
             PRAGMA synchronous = NORMAL; PRAGMA wal_autocheckpoint = 512; PRAGMA journal_size_limit = 4194304;
             PRAGMA max_page_count = {pages};"
        );
        // To turn to a log takes the file for oneself, and another program may be about the same.
        let mut tries = 0;
        while let Err(error) = connection.execute_batch(&settings) {
            let trouble = Trouble::from(error);
            tries += 1;
            if tries == 20 || !matches!(trouble, Trouble::Busy) {
                return Err(trouble);
            }
            std::thread::sleep(BUSY);
        }
        let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
        transaction.execute_batch(SCHEMA)?;
        transaction.execute("UPDATE session SET count = count + 1", [])?;
        let session = transaction.query_row("SELECT count FROM session", [], |row| row.get(0))?;
        transaction.commit()?;
        connection.busy_timeout(BUSY)?;
        let mut entries = Self {
            folder: folder.to_owned(),
            number,
            connection,
            limit,
            session,
            is_writable: true,
            places: HashMap::new(),
        };
        entries.shrink()?;
        Ok(entries)
    }

    /// A file that may not be written; what of it is in the log alone is not seen.
    pub(super) fn reading(folder: &Path, number: u32) -> Result<Self, Trouble> {
        let path = path(folder, number).to_string_lossy().into_owned();
        let escaped = path.replace('%', "%25").replace('?', "%3f").replace('#', "%23");
        let flags =
            OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_URI | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let connection = Connection::open_with_flags(format!("file:{escaped}?immutable=1"), flags)?;
        connection.query_row("SELECT count FROM session", [], |row| row.get::<_, i64>(0))?;
        let folder = folder.to_owned();
        let places = HashMap::new();
        Ok(Self { folder, number, connection, limit: 0, session: 0, is_writable: false, places })
    }

    /// Has the file get no larger, as if the disk were full.
    #[cfg(test)]
    pub(super) fn fill(&self) {
        self.connection.execute_batch("PRAGMA max_page_count = 1").unwrap();
    }

    pub(super) fn is_writable(&self) -> bool {
        self.is_writable
    }

    /// Begins anew with a file of the next number, after this one turned out to be damaged.
    pub(super) fn renewed(self) -> Result<Self, String> {
        let Self { folder, number, connection, limit, is_writable, .. } = self;
        drop(connection);
        if !is_writable {
            return Err("it is damaged, and may not be written".to_owned());
        }
        remove(&folder, number);
        Self::at(&folder, number + 1, limit).map_err(said)
    }

    /// The entries of names, as far as they are there and as they were put there.
    pub(super) fn get(&mut self, keys: &[Key]) -> Result<Vec<Found>, Trouble> {
        let places = keys.iter().map(|key| self.place(key)).collect::<Result<Vec<_>, _>>()?;
        let mut select = self
            .connection
            .prepare("SELECT id, used, checksum, data FROM entry WHERE place = ?1 AND name = ?2")?;
        let mut found = Vec::with_capacity(keys.len());
        for (key, place) in keys.iter().zip(places) {
            let [.., name] = key.parts();
            let row = |row: &rusqlite::Row<'_>| {
                let checksum: Vec<u8> = row.get(2)?;
                Ok((row.get::<_, i64>(0)?, row.get::<_, i64>(1)?, checksum, row.get::<_, Vec<u8>>(3)?))
            };
            let row = match place {
                Some(place) => select.query_row(params![place, name], row).optional()?,
                None => None,
            };
            found.push(match row {
                None => Found::Nothing,
                Some((_, _, checksum, data)) if checksum != key.checksum(&data) => Found::Damaged,
                Some((id, used, _, data)) => {
                    Found::Good(data, (self.is_writable && used < self.session).then_some(id))
                }
            });
        }
        Ok(found)
    }

    /// The number of a route's place, if it has one.
    fn place(&mut self, key: &Key) -> Result<Option<i64>, Trouble> {
        let [scene, version, _] = key.parts();
        let known = (key.origin, scene.to_owned(), version.to_owned());
        if let Some(id) = self.places.get(&known) {
            return Ok(Some(*id));
        }
        let select = "SELECT id FROM place WHERE origin = ?1 AND scene = ?2 AND version = ?3";
        let values = params![key.origin, scene, version];
        let found: Option<i64> = self.connection.query_row(select, values, |row| row.get(0)).optional()?;
        if let Some(id) = found {
            self.places.insert(known, id);
        }
        Ok(found)
    }

    /// Writes a round, all of it or nothing, after making room for it.
    pub(super) fn write(&mut self, round: &Round) -> Result<(), Trouble> {
        if !self.is_writable {
            return Ok(());
        }
        let transaction = self.connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
        let taken = bytes(&transaction)?;
        let names: u64 = round.put.keys().map(|key| ENTRY_BYTES + 2 * key.route.len() as u64).sum();
        // A quarter more: pages are not full.
        let wanted = (round.put_bytes + names) * 5 / 4;
        make_room(&transaction, (taken + wanted).saturating_sub(self.limit))?;
        for key in &round.forgotten {
            let [scene, version, name] = key.parts();
            transaction.execute(
                "DELETE FROM entry WHERE name = ?4 AND place =
                     (SELECT id FROM place WHERE origin = ?1 AND scene = ?2 AND version = ?3)",
                params![key.origin, scene, version, name],
            )?;
        }
        {
            let mut touch = transaction.prepare("UPDATE entry SET used = ?2 WHERE id = ?1")?;
            for id in &round.used {
                touch.execute(params![id, self.session])?;
            }
            let mut place = transaction.prepare(
                "INSERT INTO place (origin, scene, version) VALUES (?1, ?2, ?3)
                     ON CONFLICT DO UPDATE SET stale = stale RETURNING id",
            )?;
            let mut put = transaction.prepare(
                "INSERT INTO entry (place, name, rank, used, checksum, data) VALUES (?1, ?2, ?3, ?4, ?5, ?6)
                     ON CONFLICT DO UPDATE SET used = ?4, checksum = ?5, data = ?6",
            )?;
            for (key, (rank, data)) in &round.put {
                let [scene, version, name] = key.parts();
                let known = (key.origin, scene.to_owned(), version.to_owned());
                let place: i64 = match self.places.get(&known) {
                    Some(id) => *id,
                    None => place.query_row(params![key.origin, scene, version], |row| row.get(0))?,
                };
                put.execute(params![place, name, rank, self.session, key.checksum(data), &data[..]])?;
            }
        }
        transaction.commit()?;
        self.empty_log()
    }

    /// Empties the log where that was not done by itself, since another program was reading.
    fn empty_log(&self) -> Result<(), Trouble> {
        let mut log = path(&self.folder, self.number).into_os_string();
        log.push("-wal");
        if fs::metadata(log).is_ok_and(|data| data.len() > LOG_BYTES / 2) {
            let checkpoint = "PRAGMA wal_checkpoint(TRUNCATE)";
            // Whether another was in the way: then the next round tries again.
            self.connection.query_row(checkpoint, [], |row| row.get::<_, i64>(0))?;
        }
        Ok(())
    }

    /// Has other versions of a scene than this one be forgotten before all else.
    pub(super) fn set_current(&mut self, origin: Origin, scene: &str, version: &str) -> Result<(), Trouble> {
        if self.is_writable {
            self.connection.execute(
                "UPDATE place SET stale = (version <> ?3)
                     WHERE origin = ?1 AND scene = ?2 AND version <> '' AND stale <> (version <> ?3)",
                params![origin, scene, version],
            )?;
        }
        Ok(())
    }

    /// Bytes that the entries take.
    pub(super) fn bytes(&self) -> Result<u64, Trouble> {
        bytes(&self.connection)
    }

    /// Forgets what is beyond the limit, which was larger before, and gives it back to the disk.
    fn shrink(&mut self) -> Result<(), Trouble> {
        let pages: i64 = self.connection.query_row("PRAGMA page_count", [], |row| row.get(0))?;
        if pages.unsigned_abs() * PAGE_BYTES <= self.limit {
            return Ok(());
        }
        let over = self.bytes()?.saturating_sub(self.limit * 15 / 16);
        let transaction = self.connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
        make_room(&transaction, over)?;
        transaction.commit()?;
        for pragma in ["PRAGMA incremental_vacuum", "PRAGMA wal_checkpoint(TRUNCATE)"] {
            let mut statement = self.connection.prepare(pragma)?;
            let mut rows = statement.query([])?;
            // A page a step.
            while rows.next()?.is_some() {}
        }
        Ok(())
    }
}

fn bytes(connection: &Connection) -> Result<u64, Trouble> {
    let pragma = |name: &str| connection.query_row(&format!("PRAGMA {name}"), [], |row| row.get::<_, i64>(0));
    let pages = pragma("page_count")? - pragma("freelist_count")?;
    Ok(pages.unsigned_abs() * PAGE_BYTES)
}

/// Forgets entries until the rest takes so many bytes less than now; descriptions of scenes stay.
fn make_room(connection: &Connection, bytes_less: u64) -> Result<(), Trouble> {
    let goal = bytes(connection)?.saturating_sub(bytes_less);
    while bytes(connection)? > goal {
        let mut gone = 0;
        for which in [
            "SELECT entry.id FROM entry JOIN place ON place.id = entry.place WHERE place.stale LIMIT ?1",
            "SELECT id FROM entry WHERE name <> '' ORDER BY used, rank DESC, id LIMIT ?1",
        ] {
            if gone == 0 {
                gone = connection.execute(&format!("DELETE FROM entry WHERE id IN ({which})"), [EVICTED])?;
            }
        }
        if gone == 0 {
            break;
        }
    }
    Ok(())
}

/// Makes a folder that others do not read: what is in it may be of private scenes.
fn make_folder(folder: &Path) -> std::io::Result<()> {
    if folder.is_dir() {
        return Ok(());
    }
    let mut builder = fs::DirBuilder::new();
    builder.recursive(true);
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.create(folder)
}

fn path(folder: &Path, number: u32) -> PathBuf {
    folder.join(format!("fetched-{FORMAT}-{number}.sqlite"))
}

/// The numbers of the files that there are.
fn numbers(folder: &Path) -> impl Iterator<Item = u32> {
    let files = fs::read_dir(folder).into_iter().flatten().flatten();
    files.filter_map(|file| {
        let name = file.file_name().into_string().ok()?;
        name.strip_prefix(&format!("fetched-{FORMAT}-"))?.strip_suffix(".sqlite")?.parse().ok()
    })
}

/// Removes a file with its log. What cannot be removed is in nobody's way.
fn remove(folder: &Path, number: u32) {
    let path = path(folder, number).into_os_string();
    for suffix in ["", "-wal", "-shm"] {
        let mut path = path.clone();
        path.push(suffix);
        let _ = fs::remove_file(path);
    }
}

fn said(trouble: Trouble) -> String {
    match trouble {
        Trouble::Busy => "another program does not let go of it".to_owned(),
        Trouble::Damaged(reason) | Trouble::Disk(reason) => reason,
    }
}
