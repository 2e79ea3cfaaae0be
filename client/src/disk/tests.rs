//! Folders that are shared, damaged, full, read-only and too small.

#![allow(clippy::cast_possible_truncation, reason = "small numbers")]

use super::entries::{Found, Round, Trouble};
use super::*;
use std::fs;
use std::time::Instant;

const MIB: u64 = 1 << 20;

/// A blob of its own for each number.
fn blob(number: u32, bytes: usize) -> Bytes {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&number.to_le_bytes());
    let mut blob = vec![0; bytes];
    hasher.finalize_xof().fill(&mut blob);
    blob.into()
}

fn route(version: &str, number: u32) -> String {
    format!("/scenes/alps/{version}/terrain/points/{number}/7")
}

fn get(shelf: &Shelf, route: &str) -> Option<Bytes> {
    pollster::block_on(shelf.get(vec![route.to_owned()])).pop().flatten()
}

/// Ends the thread, and waits until it has let go of the file.
fn close(disk: Disk, shelf: Shelf, folder: &Path) {
    disk.flush();
    drop((disk, shelf));
    let began = Instant::now();
    while names(folder).iter().any(|name| name.ends_with("-wal")) {
        assert!(began.elapsed() < Duration::from_secs(20), "{:?}", names(folder));
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn bytes(folder: &Path) -> u64 {
    fs::read_dir(folder).unwrap().map(|e| e.unwrap().metadata().map_or(0, |data| data.len())).sum()
}

/// The only file of a folder.
fn file(folder: &Path) -> PathBuf {
    let names = names(folder);
    assert_eq!(names.len(), 1, "{names:?}");
    folder.join(&names[0])
}

#[test]
fn what_was_put_is_found_in_the_next_session_by_the_same_user_alone() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("new").join("folder");
    let disk = Disk::open(&place, 64 * MIB).unwrap();
    let shelf = disk.shelf("http://a", Some("secret"));
    let wanted = route("v1", 1);
    shelf.put(wanted.clone(), 3, blob(1, 5000));
    shelf.put("/scenes".to_owned(), 0, Bytes::from_static(b"{}"));
    assert_eq!(get(&shelf, &wanted), Some(blob(1, 5000)), "before it is written");
    disk.flush();
    assert_eq!(get(&shelf, &wanted), Some(blob(1, 5000)), "and after");
    close(disk, shelf, &place);
    let disk = Disk::open(&place, 64 * MIB).unwrap();
    for (base, token) in [("http://a", None), ("http://a", Some("secre")), ("http://b", Some("secret"))] {
        assert_eq!(get(&disk.shelf(base, token), &wanted), None, "{base} {token:?}");
    }
    let shelf = disk.shelf("http://a", Some("secret"));
    assert_eq!(get(&shelf, &wanted), Some(blob(1, 5000)));
    assert_eq!(get(&shelf, "/scenes").as_deref(), Some(b"{}".as_slice()));
    assert_eq!((get(&shelf, &route("v2", 1)), get(&shelf, &route("v1", 2))), (None, None));
    shelf.forget(wanted.clone());
    assert_eq!(get(&shelf, &wanted), None);
    disk.flush();
    assert_eq!(get(&shelf, &wanted), None);
    shelf.put(wanted.clone(), 3, blob(2, 10));
    assert_eq!(get(&shelf, &wanted), Some(blob(2, 10)));
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        assert_eq!(fs::metadata(&place).unwrap().permissions().mode() & 0o077, 0, "others do not read it");
    }
}

#[test]
fn a_damaged_entry_is_as_good_as_none_and_the_others_stay() {
    let folder = tempfile::tempdir().unwrap();
    let disk = Disk::open(folder.path(), 64 * MIB).unwrap();
    let shelf = disk.shelf("http://a", None);
    for number in 0..50 {
        shelf.put(route("v1", number), 3, blob(number, 3000));
    }
    close(disk, shelf, folder.path());
    let path = file(folder.path());
    let mut all = fs::read(&path).unwrap();
    let found = blob(17, 3000);
    // Wherever it lies: a page that the database has moved may lie about where it was, too.
    let is_there = |at: &usize| all[*at..*at + 100] == found[..100];
    let places: Vec<usize> = (0..all.len() - 100).filter(is_there).collect();
    assert!(!places.is_empty());
    for at in places {
        all[at + 50] ^= 4;
    }
    fs::write(&path, all).unwrap();
    let disk = Disk::open(folder.path(), 64 * MIB).unwrap();
    let shelf = disk.shelf("http://a", None);
    for number in 0..50 {
        let expected = (number != 17).then(|| blob(number, 3000));
        assert_eq!(get(&shelf, &route("v1", number)), expected, "{number}");
    }
    shelf.put(route("v1", 17), 3, blob(17, 3000));
    disk.flush();
    assert_eq!(get(&shelf, &route("v1", 17)), Some(blob(17, 3000)));
    assert_eq!(disk.problem(), None, "nobody need know");
}

#[test]
fn a_file_that_is_damaged_or_none_begins_anew() {
    let folder = tempfile::tempdir().unwrap();
    let disk = Disk::open(folder.path(), 64 * MIB).unwrap();
    let shelf = disk.shelf("http://a", None);
    for number in 0..200 {
        shelf.put(route("v1", number), 3, blob(number, 3000));
    }
    close(disk, shelf, folder.path());
    let path = file(folder.path());
    // Garbage after the first page: what it says of itself is right, and nothing else.
    let mut all = fs::read(&path).unwrap();
    let (kept, length) = (8192, all.len());
    all.truncate(kept);
    all.extend_from_slice(&blob(99, length - kept));
    fs::write(&path, all).unwrap();
    let disk = Disk::open(folder.path(), 64 * MIB).unwrap();
    let shelf = disk.shelf("http://a", None);
    for number in 0..200 {
        assert_eq!(get(&shelf, &route("v1", number)), None, "{number}");
    }
    shelf.put(route("v1", 1), 3, blob(1, 3000));
    disk.flush();
    assert_eq!(get(&shelf, &route("v1", 1)), Some(blob(1, 3000)), "{:?}", disk.problem());
    close(disk, shelf, folder.path());
    assert_ne!(file(folder.path()), path, "the damaged one is gone");
    fs::write(file(folder.path()), "no database at all").unwrap();
    let disk = Disk::open(folder.path(), 64 * MIB).unwrap();
    let shelf = disk.shelf("http://a", None);
    assert_eq!(get(&shelf, &route("v1", 1)), None);
    shelf.put(route("v1", 1), 3, blob(1, 3000));
    disk.flush();
    assert_eq!(get(&shelf, &route("v1", 1)), Some(blob(1, 3000)));
}

#[test]
fn the_limit_holds_and_the_finest_of_the_oldest_session_go_first() {
    let folder = tempfile::tempdir().unwrap();
    let disk = Disk::open(folder.path(), 48 * MIB).unwrap();
    let shelf = disk.shelf("http://a", None);
    // Of the finest 80 MiB, of the coarser ones 5.
    let (fine, coarse) = (0..4000, 4000..4250);
    for (i, number) in coarse.clone().chain(fine).enumerate() {
        shelf.put(route("v1", number), if coarse.contains(&number) { 2 } else { 9 }, blob(number, 20 << 10));
        if i % 100 == 99 {
            disk.flush();
            assert!(bytes(folder.path()) <= 48 * MIB, "{}", bytes(folder.path()));
        }
    }
    let held = disk.flush();
    assert!(held > 34 * MIB && held <= 40 * MIB, "{held}");
    assert!(coarse.clone().all(|n| get(&shelf, &route("v1", n)).is_some()), "coarse ones stay");
    let held = [3999, 2700, 0].map(|number| get(&shelf, &route("v1", number)).is_some());
    assert_eq!(held, [true, true, false]);
    assert_eq!(disk.problem(), None);
    close(disk, shelf, folder.path());
    // The next session uses the coarse ones and some fine ones, and fetches others.
    let disk = Disk::open(folder.path(), 48 * MIB).unwrap();
    let shelf = disk.shelf("http://a", None);
    let used = 3900..4000;
    assert!(used.clone().chain(coarse.clone()).all(|n| get(&shelf, &route("v1", n)).is_some()));
    for number in 5000..6000 {
        shelf.put(route("v1", number), 9, blob(number, 20 << 10));
        if number % 100 == 99 {
            disk.flush();
        }
    }
    disk.flush();
    assert!(used.chain(coarse).all(|n| get(&shelf, &route("v1", n)).is_some()), "what is used stays");
    assert!(get(&shelf, &route("v1", 2700)).is_none(), "what no session used since goes");
    close(disk, shelf, folder.path());
    // A smaller limit.
    let disk = Disk::open(folder.path(), LIMIT_MIN).unwrap();
    assert!(bytes(folder.path()) <= LIMIT_MIN && disk.flush() > 12 * MIB, "{}", bytes(folder.path()));
    assert!(matches!(Disk::open(folder.path(), LIMIT_MIN - 1), Err(DiskError::Limit(_))));
}

#[test]
fn versions_that_are_not_current_go_before_all_else() {
    let folder = tempfile::tempdir().unwrap();
    let disk = Disk::open(folder.path(), LIMIT_MIN).unwrap();
    let shelf = disk.shelf("http://a", None);
    let put = |version: &str, numbers: std::ops::Range<u32>, rank: u32| {
        for number in numbers {
            shelf.put(route(version, number), rank, blob(number, 20 << 10));
            if number % 100 == 99 {
                disk.flush();
            }
        }
        disk.flush();
    };
    put("v1", 0..400, 0);
    put("v2", 0..400, 9);
    shelf.put("/scenes/alps".to_owned(), 0, Bytes::from_static(b"description"));
    shelf.set_current("alps", "v2");
    put("v2", 400..1000, 9);
    let held = |version: &str| (0..1000).filter(|n| get(&shelf, &route(version, *n)).is_some()).count();
    assert_eq!((held("v1"), get(&shelf, "/scenes/alps").is_some()), (0, true));
    assert!(held("v2") > 900, "{}", held("v2"));
    // Gone back to.
    shelf.set_current("alps", "v1");
    put("v1", 0..500, 9);
    assert_eq!(held("v1"), 500);
}

#[test]
fn two_at_once_do_each_other_no_harm() {
    let folder = tempfile::tempdir().unwrap();
    let hammer = |from: u32| {
        let disk = Disk::open(folder.path(), LIMIT_MIN).unwrap();
        let shelf = disk.shelf("http://a", None);
        for number in from..from + 600 {
            shelf.put(route("v1", number), number % 9, blob(number, 20 << 10));
            // Whatever is there is right, whoever put it there.
            let other = (number * 7919) % 1200;
            if let Some(found) = get(&shelf, &route("v1", other)) {
                assert_eq!(found, blob(other, 20 << 10));
            }
        }
        disk.flush();
        assert_eq!(disk.problem(), None);
    };
    std::thread::scope(|threads| {
        threads.spawn(|| hammer(0));
        threads.spawn(|| hammer(600));
    });
    assert!(bytes(folder.path()) <= LIMIT_MIN);
    let disk = Disk::open(folder.path(), LIMIT_MIN).unwrap();
    let shelf = disk.shelf("http://a", None);
    let held = (0..1200).filter(|number| get(&shelf, &route("v1", *number)) == Some(blob(*number, 20 << 10)));
    let held = held.count();
    // Whoever found the other writing for too long has let some go.
    assert!(held > 300, "{held}");
}

#[test]
fn a_full_disk_is_told_once_and_costs_what_is_not_kept() {
    let folder = tempfile::tempdir().unwrap();
    let mut entries = Entries::open(folder.path(), LIMIT_MIN).unwrap();
    let key = |number| Key { origin: Origin::default(), route: route("v1", number) };
    let round = |number| {
        let data = blob(number, 100_000);
        let put = [(key(number), (3, data))].into_iter().collect();
        Round { put, put_bytes: 100_000, ..Round::default() }
    };
    entries.write(&round(1)).unwrap();
    // As many pages as there are: the disk gives no more.
    entries.fill();
    assert!(matches!(entries.write(&round(2)), Err(Trouble::Disk(_))));
    let found = entries.get(&[key(1)]).unwrap();
    assert!(matches!(found[..], [Found::Good(..)]));
    let watch = Arc::new(Watch::default());
    let keeper = Keeper::new(entries, Arc::clone(&watch));
    let (orders, receiver) = mpsc::channel();
    let thread = std::thread::spawn(move || keeper.run(&receiver));
    let disk = Disk(Arc::new(Inner { orders, watch }));
    let shelf = Shelf { disk: disk.clone(), origin: Origin::default() };
    for number in 3..10 {
        shelf.put(route("v1", number), 3, blob(number, 100_000));
        disk.flush();
    }
    assert!(disk.problem().unwrap().contains("free some space"), "{:?}", disk.problem());
    assert_eq!(get(&shelf, &route("v1", 1)), Some(blob(1, 100_000)), "what is there is found");
    assert_eq!(disk.0.watch.waiting.load(Ordering::Relaxed), 0);
    drop((disk, shelf));
    thread.join().unwrap();
}

#[test]
fn a_folder_that_may_not_be_written_is_read_and_one_that_cannot_be_is_said_plainly() {
    let folder = tempfile::tempdir().unwrap();
    let disk = Disk::open(folder.path(), LIMIT_MIN).unwrap();
    let shelf = disk.shelf("http://a", None);
    shelf.put(route("v1", 1), 3, blob(1, 3000));
    let origin = shelf.origin;
    close(disk, shelf, folder.path());
    // As it is opened where writing is refused: whoever tests as root may write everywhere.
    let before = fs::read(file(folder.path())).unwrap();
    let mut entries = Entries::reading(folder.path(), 1).unwrap();
    let key = Key { origin, route: route("v1", 1) };
    let found = entries.get(std::slice::from_ref(&key)).unwrap();
    assert!(matches!(&found[..], [Found::Good(found, None)] if *found == blob(1, 3000)));
    let round = Round { forgotten: vec![key], ..Round::default() };
    entries.write(&round).unwrap();
    let watch = Arc::new(Watch::default());
    drop(Keeper::new(entries, Arc::clone(&watch)));
    assert!(watch.problem().unwrap().contains("may not be written"));
    assert_eq!(fs::read(file(folder.path())).unwrap(), before);
    let below_a_file = file(folder.path()).join("cache");
    let told = Disk::open(&below_a_file, LIMIT_MIN).unwrap_err().to_string();
    assert!(told.contains("cannot be used as a disk cache") && told.contains("--disk-cache"), "{told}");
}
