//! One request, sent once and timed: for those who count what a server does, and neither retry nor cancel.

use super::FetchError;
use super::batch::{Batch, Frames};
use super::http::{PAGE_BYTES_MAX, decode_page, good_payload, only, refusal, shortened, transport};
use crate::encoding::Encoding;
use bytes::Bytes;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::index::Entry;
use diamantina_protocol::message::{self, Catalogue, Scene};
use reqwest::{Client, Response, StatusCode};
use std::collections::HashMap;
use std::time::{Duration, Instant};

/// What is asked for.
#[derive(Debug)]
pub(crate) enum Ask {
    /// A page of a layer's index.
    Page(usize, u32),
    /// Diamonds of a layer, with the bytes of their payloads where the index tells.
    Batch(usize, Vec<(Diamond, Option<u32>)>),
}

impl Ask {
    /// Diamonds in the order given, in as few batches as may be.
    pub(crate) fn batches(
        base: &str,
        scene: &Scene,
        encoding: Encoding,
        wants: impl Iterator<Item = (usize, Diamond, Option<u32>)>,
    ) -> Vec<Self> {
        let mut list: Vec<Batch> = Vec::new();
        for (layer, d, bytes) in wants {
            let has_room = list.last_mut().is_some_and(|last| last.layer == layer && last.push(d, bytes));
            if !has_room {
                let mut batch = Batch::new(base, scene, encoding, layer);
                batch.push(d, bytes);
                list.push(batch);
            }
        }
        list.into_iter().map(|batch| Self::Batch(batch.layer, batch.wants)).collect()
    }
}

/// A page of a layer's index: the layer, its number, what it tells.
pub(crate) type Page = (usize, u32, Vec<(Diamond, Entry)>);

/// What came.
#[derive(Debug, Default)]
pub(crate) struct Answer {
    /// From sending the request to the last byte.
    pub(crate) took: Duration,
    /// From sending the request to the last byte of each diamond.
    pub(crate) times: Vec<Duration>,
    /// Of the answer, without its headers.
    pub(crate) bytes: usize,
    /// A page of a layer's index.
    pub(crate) page: Option<Page>,
    /// Payloads, with their layers.
    pub(crate) payloads: Vec<(usize, Diamond, Bytes)>,
}

async fn get(client: &Client, base: &str, route: &str) -> Result<Response, FetchError> {
    let response = client.get(format!("{base}{route}")).send().await.map_err(|e| transport(&e))?;
    if response.status() == StatusCode::OK { Ok(response) } else { Err(refusal(route, &response)) }
}

/// A scene's description, or that of a server's only scene.
///
/// # Errors
/// When there is none, or it cannot be shown.
pub(crate) async fn describe(client: Client, base: &str, name: Option<&str>) -> Result<Scene, FetchError> {
    let route = name.map_or_else(|| "/scenes".to_owned(), message::scene_route);
    let body = get(&client, base, &route).await?.bytes().await.map_err(|e| transport(&e))?;
    let wrong = |e: serde_json::Error| FetchError::Json { route: shortened(&route), reason: e.to_string() };
    let scene = match name {
        Some(_) => serde_json::from_slice(&body).map_err(wrong)?,
        None => only(serde_json::from_slice::<Catalogue>(&body).map_err(wrong)?)?,
    };
    super::check_scene(&scene)
        .map_err(|reason| FetchError::Scene { scene: shortened(&scene.name), reason })?;
    Ok(scene)
}

/// Sends one request and reads its answer, which is checked as far as that can be without decoding.
///
/// # Errors
/// When nothing comes, or something else than was asked for.
pub(crate) async fn one(
    client: &Client,
    base: &str,
    scene: &Scene,
    encoding: Encoding,
    ask: &Ask,
) -> Result<Answer, FetchError> {
    let began = Instant::now();
    let mut answer = Answer::default();
    match ask {
        Ask::Page(layer, number) => {
            let route = encoding.index_route(scene, *layer, *number);
            let mut response = get(client, base, &route).await?;
            let mut body = Vec::new();
            while let Some(chunk) = response.chunk().await.map_err(|e| transport(&e))? {
                body.extend_from_slice(&chunk);
                if body.len() > PAGE_BYTES_MAX {
                    return Err(FetchError::TooLarge { route: shortened(&route), limit: PAGE_BYTES_MAX });
                }
            }
            (answer.took, answer.bytes) = (began.elapsed(), body.len());
            let entries = decode_page(&scene.layers[*layer].forest, *number, &body)?;
            answer.page = Some((*layer, *number, entries));
        }
        Ask::Batch(layer, wants) => {
            let centres: Vec<_> = wants.iter().map(|(d, _)| d.centre()).collect();
            let route = encoding.batch_route(scene, *layer, &centres);
            let mut response = get(client, base, &route).await?;
            let mut owed: HashMap<[u32; 2], (Diamond, Option<u32>)> =
                wants.iter().map(|want| (want.0.centre(), *want)).collect();
            let mut frames = Frames::default();
            while let Some(chunk) = response.chunk().await.map_err(|e| transport(&e))? {
                answer.bytes += chunk.len();
                frames.push(&chunk);
                while let Some((header, payload)) = frames.take()? {
                    let (d, bytes) = owed.remove(&header.centre).ok_or(FetchError::Unasked(header.centre))?;
                    good_payload(d, bytes, &header, &payload)?;
                    answer.times.push(began.elapsed());
                    answer.payloads.push((*layer, d, payload));
                }
            }
            answer.took = began.elapsed();
            if !owed.is_empty() || !frames.is_empty() {
                return Err(FetchError::Early(shortened(&route)));
            }
        }
    }
    Ok(answer)
}
