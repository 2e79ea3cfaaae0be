//! The simplified halves of a level's diamonds, on the builder's own disk until the level above has read them.
//!
//! Each half is read once: by the parent that it becomes a quarter of. A file holds the halves of a level, one behind
//! the other as they are done; where they lie is the journal's to know.
//!
//! | offset | size | field |
//! |---|---|---|
//! | 0 | 8 | XXH3 of what follows |
//! | 8 | 8 | how far what was left out lies from what is there, in metres |
//! | 16 | 4 + 4 + 4 | vertices v, triangles t, borders b |
//! | 28 | 4 | errors e: t or 0 |
//! | 32 | 4 | needs n: v or 0 |
//! | 36 | 12 v | x, y, height |
//! | .. | 12 t, or 6 t where indices fit in 16 bits | indices |
//! | .. | 4 e | how far samples are from each triangle, in quanta |
//! | .. | 2 n | what vertices need at least to go, in quanta: the upper half of an `f32` |
//! | .. | 12 b | two vertices, points |
//! | .. | 8 a point | x, y |

use crate::tin::Tin;
use diamantina_protocol::tin::Vertex;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use xxhash_rust::xxh3::xxh3_64;

/// Where the two halves of a diamond lie: one behind the other. No bytes: it has no triangles.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(in crate::hierarchy) struct Place {
    /// Bytes before them.
    pub(in crate::hierarchy) offset: u64,
    /// Bytes of each.
    pub(in crate::hierarchy) bytes: [u32; 2],
}

impl Place {
    fn end(&self) -> u64 {
        self.offset + u64::from(self.bytes[0]) + u64::from(self.bytes[1])
    }
}

/// The halves of a level.
#[derive(Debug)]
pub(super) struct Halves {
    file: File,
    path: PathBuf,
    end: AtomicU64,
}

fn path(folder: &Path, level: u32) -> PathBuf {
    folder.join(format!("tin-{level}"))
}

impl Halves {
    /// Opens the file of a level, with the halves that lie in `known` in it; what is behind them is cut off. `None` if
    /// they are not all there.
    pub(super) fn open(
        folder: &Path,
        level: u32,
        known: impl Iterator<Item = Place>,
    ) -> io::Result<Option<Self>> {
        let path = path(folder, level);
        let file = File::options().create(true).truncate(false).read(true).write(true).open(&path)?;
        let end = known.map(|place| place.end()).max().unwrap_or(0);
        if file.metadata()?.len() < end {
            return Ok(None);
        }
        file.set_len(end)?;
        Ok(Some(Self { file, path, end: AtomicU64::new(end) }))
    }

    /// Removes the file of a level, if there is one.
    pub(super) fn remove(folder: &Path, level: u32) -> io::Result<()> {
        match std::fs::remove_file(path(folder, level)) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => Err(e),
            _ => Ok(()),
        }
    }

    /// Makes sure that what was put is on the disk.
    pub(super) fn sync(&self) -> io::Result<()> {
        self.file.sync_data()
    }

    /// Adds the halves of a diamond.
    pub(super) fn put(&self, halves: &[Tin; 2]) -> io::Result<Place> {
        let mut bytes = Vec::new();
        let mut lengths = [0; 2];
        for (half, length) in halves.iter().zip(&mut lengths) {
            let before = bytes.len();
            if !half.triangles.is_empty() {
                write(half, &mut bytes);
            }
            *length = u32::try_from(bytes.len() - before).map_err(|_| io::ErrorKind::FileTooLarge)?;
        }
        if bytes.is_empty() {
            return Ok(Place::default());
        }
        let offset = self.end.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        self.file.write_all_at(&bytes, offset)?;
        Ok(Place { offset, bytes: lengths })
    }

    /// Reads one half of a diamond back.
    pub(super) fn get(&self, place: Place, half: usize) -> io::Result<Tin> {
        let mut bytes = vec![0; place.bytes[half] as usize];
        if bytes.is_empty() {
            return Ok(Tin::default());
        }
        let offset = place.offset + if half > 0 { u64::from(place.bytes[0]) } else { 0 };
        self.file.read_exact_at(&mut bytes, offset)?;
        read(&bytes).ok_or_else(|| {
            let what = format!(
                "{}: damaged since it was written (at byte {offset}): build again with --fresh",
                self.path.display()
            );
            io::Error::new(io::ErrorKind::InvalidData, what)
        })
    }
}

/// Vertices up to which an index takes 16 bits.
const SHORT_MAX: usize = 1 << 16;

fn write(tin: &Tin, out: &mut Vec<u8>) {
    let start = out.len();
    out.extend([0; 8]);
    out.extend(tin.lost.to_le_bytes());
    let mut put = |number: u32| out.extend(number.to_le_bytes());
    for count in
        [tin.vertices.len(), tin.triangles.len(), tin.borders.len(), tin.errors.len(), tin.needs.len()]
    {
        put(u32::try_from(count).unwrap_or(u32::MAX));
    }
    for v in &tin.vertices {
        [v.x, v.y, v.height.cast_unsigned()].into_iter().for_each(&mut put);
    }
    if tin.vertices.len() <= SHORT_MAX {
        for v in tin.triangles.as_flattened() {
            out.extend(u16::try_from(*v).unwrap_or(u16::MAX).to_le_bytes());
        }
    } else {
        tin.triangles.as_flattened().iter().for_each(|v| out.extend(v.to_le_bytes()));
    }
    tin.errors.iter().for_each(|error| out.extend(error.to_le_bytes()));
    tin.needs.iter().for_each(|need| out.extend(need.to_le_bytes()));
    for ([a, b], points) in &tin.borders {
        for number in [*a, *b, u32::try_from(points.len()).unwrap_or(u32::MAX)] {
            out.extend(number.to_le_bytes());
        }
        points.as_flattened().iter().for_each(|w| out.extend(w.to_le_bytes()));
    }
    let checksum = xxh3_64(&out[start + 8..]);
    out[start..start + 8].copy_from_slice(&checksum.to_le_bytes());
}

/// What [`write`] wrote; `None` if it is not that any more.
fn read(bytes: &[u8]) -> Option<Tin> {
    let (checksum, rest) = bytes.split_first_chunk::<8>()?;
    if u64::from_le_bytes(*checksum) != xxh3_64(rest) {
        return None;
    }
    let (lost, mut rest) = rest.split_first_chunk::<8>()?;
    let mut numbers = |count: usize| {
        let (now, later) = rest.split_at_checked(4 * count)?;
        rest = later;
        Some(now.as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b)))
    };
    let counts: Vec<usize> = numbers(5)?.map(|n| n as usize).collect();
    let mut tin = Tin { lost: f64::from_le_bytes(*lost), ..Tin::default() };
    let flat: Vec<u32> = numbers(3 * counts[0])?.collect();
    let vertex = |v: &[u32; 3]| Vertex { x: v[0], y: v[1], height: v[2].cast_signed() };
    tin.vertices = flat.as_chunks::<3>().0.iter().map(vertex).collect();
    if counts[0] <= SHORT_MAX {
        let (now, later) = rest.split_at_checked(6 * counts[1])?;
        rest = later;
        let flat = now.as_chunks::<2>().0.iter().map(|b| u32::from(u16::from_le_bytes(*b)));
        let flat: Vec<u32> = flat.collect();
        tin.triangles = flat.as_chunks::<3>().0.to_vec();
    } else {
        let flat: Vec<u32> = numbers(3 * counts[1])?.collect();
        tin.triangles = flat.as_chunks::<3>().0.to_vec();
    }
    let (errors, rest) = rest.split_at_checked(4 * counts[3])?;
    tin.errors = errors.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    let (needs, mut rest) = rest.split_at_checked(2 * counts[4])?;
    tin.needs = needs.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)).collect();
    let mut numbers = |count: usize| {
        let (now, later) = rest.split_at_checked(4 * count)?;
        rest = later;
        Some(now.as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b)))
    };
    for _ in 0..counts[2] {
        let head: Vec<u32> = numbers(3)?.collect();
        let flat: Vec<u32> = numbers(2 * head[2] as usize)?.collect();
        tin.borders.push(([head[0], head[1]], flat.as_chunks::<2>().0.to_vec()));
    }
    Some(tin)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tin(vertices: u32) -> Tin {
        let vertex = |i: u32| Vertex { x: i, y: 2 * i, height: -i.cast_signed() };
        Tin {
            vertices: (0..vertices).map(vertex).collect(),
            triangles: vec![[0, 1, vertices - 1], [2, 1, 0]],
            borders: vec![([0, 1], vec![[5, 6], [7, 8]]), ([1, 2], vec![])],
            errors: vec![0.5, 7.25],
            needs: (0..vertices).map(|i| u16::try_from(i % 7).unwrap()).collect(),
            lost: 12.5,
            untouched: Vec::new(),
        }
    }

    #[test]
    fn halves_come_back_and_damage_is_seen() {
        let folder = tempfile::tempdir().unwrap();
        let halves = Halves::open(folder.path(), 3, std::iter::empty()).unwrap().unwrap();
        let first = halves.put(&[tin(9), Tin::default()]).unwrap();
        let second = halves.put(&[tin(70_000), tin(3)]).unwrap();
        assert_eq!(halves.put(&[Tin::default(), Tin::default()]).unwrap(), Place::default());
        drop(halves);
        // Another run goes on with them.
        let halves = Halves::open(folder.path(), 3, [first, second].into_iter()).unwrap().unwrap();
        assert_eq!(halves.get(first, 0).unwrap(), tin(9));
        assert_eq!(halves.get(first, 1).unwrap(), Tin::default());
        assert_eq!(halves.get(second, 0).unwrap(), tin(70_000));
        assert_eq!(halves.get(second, 1).unwrap(), tin(3));
        halves.file.write_all_at(&[77], first.offset + 40).unwrap();
        assert!(halves.get(first, 0).unwrap_err().to_string().contains("--fresh"));
        // What was cut off is missed.
        halves.file.set_len(second.offset).unwrap();
        drop(halves);
        assert!(Halves::open(folder.path(), 3, [first, second].into_iter()).unwrap().is_none());
    }
}
