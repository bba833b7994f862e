// node-mavlink on UDP: node_client.mjs PORT SECONDS [KEY as hexadecimal]. Prints one JSON object: what was heard, what was lost.
import dgram from 'node:dgram'
import { PassThrough } from 'node:stream'
import {
  MavLinkPacketParser, MavLinkPacketSplitter, MavLinkProtocolV2, minimal, common,
} from 'node-mavlink'

const [port, seconds, hex] = process.argv.slice(2)
const key = hex ? Buffer.from(hex, 'hex') : null
const registry = { ...minimal.REGISTRY, ...common.REGISTRY }
const socket = dgram.createSocket({ type: 'udp4', recvBufferSize: 1 << 22 })
const bytes = new PassThrough()
const packets = bytes.pipe(new MavLinkPacketSplitter()).pipe(new MavLinkPacketParser())
const out = new MavLinkProtocolV2(255, 190)
const result = { heard: {}, lost: 0, signed: 0, wrong: 0, parameters: {}, acks: {}, attitude: null, position: null }
let peer, last = null, sequence = 0, asked = false, began = Date.now()

function send(message) {
  let frame = out.serialize(message, sequence++ & 255)
  if (key) {
    out.incompatibilityFlags = MavLinkProtocolV2.IFLAG_SIGNED
    frame = out.sign(out.serialize(message, (sequence - 1) & 255), 9, key)
  }
  socket.send(frame, peer.port, peer.address)
}

function command(number, ...params) {
  const made = new common.CommandLong()
  Object.assign(made, { targetSystem: 1, targetComponent: 1, command: number, confirmation: 0 })
  for (let i = 0; i < 7; i++) made[`_param${i + 1}`] = params[i] ?? 0
  send(made)
}

function ask() {
  asked = true
  const list = new common.ParamRequestList()
  Object.assign(list, { targetSystem: 1, targetComponent: 1 })
  send(list)
  setTimeout(() => {
    const set = new common.ParamSet()
    Object.assign(set, { targetSystem: 1, targetComponent: 1, paramId: 'SR_HUD_HZ', paramValue: 7, paramType: 9 })
    send(set)
  }, 300)
  setTimeout(() => command(511, 30, 4000), 600) // SET_MESSAGE_INTERVAL of ATTITUDE: 250 Hz
  setTimeout(() => command(512, 148), 900) // REQUEST_MESSAGE: AUTOPILOT_VERSION
}

packets.on('data', packet => {
  if (packet.header.sysid !== 1) return
  if (last !== null) result.lost += (packet.header.seq - last - 1) & 255
  last = packet.header.seq
  if (packet.signature) {
    if (key && packet.signature.matches(key)) result.signed++
    else result.wrong++
  }
  const kind = registry[packet.header.msgid]
  if (!kind) return
  result.heard[kind.MSG_NAME] = (result.heard[kind.MSG_NAME] ?? 0) + 1
  const data = packet.protocol.data(packet.payload, kind)
  if (kind === common.ParamValue) result.parameters[data.paramId] = data.paramValue
  if (kind === common.CommandAck) result.acks[data.command] = data.result
  if (kind === common.Attitude) result.attitude = [data.timeBootMs, data.roll, data.pitch, data.yaw]
  if (kind === common.GlobalPositionInt) result.position = [data.lat, data.lon, data.alt]
  if (!asked && Date.now() - began > 300) ask()
})

function end() { console.log(JSON.stringify(result)); process.exit(0) }

socket.on('message', (data, from) => {
  if (!peer) { began = Date.now(); setTimeout(end, 1000 * Number(seconds)) }
  peer = from
  bytes.write(data)
})
socket.bind(Number(port), '127.0.0.1')
setTimeout(end, 1000 * (Number(seconds) + 60)) // nothing has come
